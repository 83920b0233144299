"""The exceptions of lmdsl: every message says what is wrong, where, and what to do."""

from typing import Any

LONGEST = 300  # characters of a path that are shown


class LmdslError(Exception):
    """Base of every error that lmdsl raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle and copy what the error holds, whatever its class takes to be made."""
        return _revived, (type(self), self.args, vars(self))


def _revived(kind: type[LmdslError], args: tuple[Any, ...], state: dict[str, Any]) -> LmdslError:
    error = kind.__new__(kind)
    error.args = args
    vars(error).update(state)
    return error


class BadInput(LmdslError, ValueError):
    """What the user wrote cannot be used (exit status 2 on the command line).

    Parameters
    ----------
    message
        One line that names the fault and the fix.
    where
        The path of the field at fault, such as ``state_box.x.cells``; empty when
        the fault has no field.
    """

    def __init__(self, message: str, where: str = "") -> None:
        self.where = where
        self.message = message
        # A path holds keys of a file, as they are written there.
        super().__init__(f"{printable(f'{where}'[:LONGEST])}: {message}" if where else message)


class MissingDependency(BadInput):
    """An optional package is needed and not installed."""


def shown(value: object, limit: int = 60) -> str:
    """Return a short, printable, terminal-safe form of a value for a message."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 256:
        return f"an integer of about {int(value.bit_length() * 0.30103) + 1} digits"
    if isinstance(value, dict | list | tuple) and len(value) > 8:
        return f"a {type(value).__name__} of {len(value)} items"
    if isinstance(value, str) and len(value) > limit:
        value = value[:limit] + "..."
    shape = getattr(value, "shape", ())
    if isinstance(shape, tuple) and shape:
        return f"an array of shape {shape}"
    try:
        text = ascii(value)
    except Exception:  # somebody else's object
        text = f"a {type(value).__name__}"
    if "\n" in text:
        text = " ".join(text.split())
    return text if len(text) <= 2 * limit else text[: 2 * limit] + "..."


def printable(text: str) -> str:
    """Return text on one line that a terminal shows as it is: control characters are escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def plain_text(value: object, limit: int = 200) -> str:
    """Return what somebody else's object says of itself: one printable line, whatever it does.

    An object that cannot say anything is named by its class.
    """
    try:
        text = str(value)[: 2 * limit]
        text = str.encode(text, "utf-8", "backslashreplace").decode()  # no class of its own
    except (KeyboardInterrupt, MemoryError):
        raise
    except BaseException:
        text = f"an unprintable {type.__dict__['__name__'].__get__(type(value))}"
    return printable(" ".join(text.split()))[:limit]
