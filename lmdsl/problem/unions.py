"""Unions of models: told apart by ``kind``, or by a key that only one of them has."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Discriminator, Tag

from lmdsl.common.strict_model import Declared, SchemaWords


class EachWords(SchemaWords):
    """Words for each number of a list."""

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        schema = handler(core)
        return {**schema, "items": {**schema["items"], **self.words}}


def _tag_by_kind(value: Any) -> str:
    kind = value.get("kind") if isinstance(value, Mapping) else getattr(value, "kind", None)
    return f"<{kind}>" if isinstance(kind, str) else "<?>"


def tag_by_key(key: str, model: type) -> Any:
    """Tell a model from another by a key that only it has."""

    def tag(value: Any) -> str:
        held = isinstance(value, model) or (isinstance(value, Mapping) and key in value)
        return "<a>" if held else "<b>"

    return Discriminator(tag)


def kinds(*models: type[Declared]) -> Any:
    """Return the union of models told apart by their ``kind``."""
    tagged = [Annotated[m, Tag(f"<{m.model_fields['kind'].default}>")] for m in models]
    union: Any = tagged[0]
    for member in tagged[1:]:
        union = union | member
    names = ", ".join(str(m.model_fields["kind"].default) for m in models)
    return Annotated[
        union,
        Discriminator(
            _tag_by_kind,
            custom_error_type="kind",
            custom_error_message=f"'kind' is missing or unknown; known kinds: {names}",
        ),
    ]
