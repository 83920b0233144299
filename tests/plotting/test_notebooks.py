"""In a notebook every plot shows its picture once, whoever draws it, and nothing is switched on."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest

from lmdsl import plotting
from lmdsl.plotting import layers, shown

pytest.importorskip("matplotlib")

PNG = b"\x89PNG\r\n\x1a\n"


class Shell:
    """What lmdsl asks of the shell of a notebook, and what a cell shows."""

    def __init__(self):
        self.kernel = object()
        self.printers, self.hooks, self.displayed = {}, {}, []
        png = SimpleNamespace(for_type=self.printers.__setitem__)
        self.display_formatter = SimpleNamespace(formatters={"image/png": png})
        self.events = SimpleNamespace(register=self.hooks.__setitem__)

    def display(self, item):
        """Show an object as IPython does: by the printer of its class, or its own method."""
        printers = [self.printers[c] for c in type(item).__mro__ if c in self.printers]
        printer = printers[0] if printers else getattr(type(item), "_repr_png_", None)
        if printer is not None:
            self.displayed.append(printer(item))

    def cell(self, run):
        """Run a cell: its value is shown, then what waits for its end."""
        self.displayed = []
        value = run()
        self.display(value)
        self.hooks.get("post_execute", lambda: None)()
        return self.displayed


@pytest.fixture
def shell(monkeypatch):
    made = Shell()
    module = SimpleNamespace(get_ipython=lambda: made, display=made.display, version_info=(9, 0))
    monkeypatch.setitem(sys.modules, "IPython", module)
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    monkeypatch.setattr(shown, "_shells", set())
    return made


def test_the_value_of_a_cell_is_shown_once(solved, shell):
    for draw in (plotting.cost, plotting.portrait):
        (picture,) = shell.cell(lambda draw=draw: draw(solved("logistic")))
        assert picture.startswith(PNG)
    (page,) = shell.cell(lambda: plotting.slices(solved("lorenz"), panels=2))
    assert page.startswith(PNG)


def test_pictures_that_are_no_value_are_shown_at_the_end(solved, shell):
    def cell():
        for draw in (plotting.cost, plotting.control):
            draw(solved("logistic"))
        return plotting.measure(solved("logistic"))

    pictures = shell.cell(cell)
    assert len(pictures) == 3 == len(set(pictures))
    assert shell.cell(lambda: None) == []
    ax = plotting.cost(solved("logistic"))
    assert len(shell.cell(lambda: ax)) == 1


def test_inline_figures_of_matplotlib_change_nothing(solved, shell):
    from matplotlib.figure import Figure

    shell.printers[Figure] = lambda figure: b"of the backend"  # as %matplotlib inline does
    assert [p[:8] for p in shell.cell(lambda: plotting.cost(solved("logistic")).figure)] == [PNG]


def test_axes_that_are_given_are_shown_by_whom_they_belong_to(solved, shell):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure()
    FigureCanvasAgg(figure)
    assert shell.cell(lambda: plotting.cost(solved("logistic"), figure.add_subplot())) == []


def test_parts_of_something_else_are_not_shown(solved, shell):
    def cell():
        with layers.apart():
            plotting.cost(solved("logistic"))

    assert shell.cell(cell) == []
    assert len(shell.cell(lambda: plotting.cost(solved("logistic")) and None)) == 1


def test_nothing_waits_outside_notebooks(solved, monkeypatch):
    for module in (None, SimpleNamespace(get_ipython=lambda: None, version_info=(9, 0))):
        monkeypatch.setitem(sys.modules, "IPython", module)
        plotting.cost(solved("logistic"))
        assert shown._waiting == []


def test_a_real_shell_shows_them(solved):
    pytest.importorskip("IPython")
    from IPython.core.interactiveshell import InteractiveShell
    from IPython.utils.capture import capture_output

    own = InteractiveShell.instance()
    own.kernel = None
    own.display_formatter.active_types = own.display_formatter.format_types  # as in notebooks
    try:
        own.user_ns.update(plotting=plotting, result=solved("logistic"))
        with capture_output() as shown_:
            own.run_cell("plotting.cost(result); x = plotting.measure(result)")
        assert ["image/png" in output.data for output in shown_.outputs] == [True, True]
        with capture_output() as shown_:
            value = own.run_cell("plotting.cost(result)").result
        assert shown_.outputs == []  # as the value of the cell, and that once
        assert value.figure.seen
        assert "text/html" in own.display_formatter.format(solved("logistic"))[0]
    finally:
        InteractiveShell.clear_instance()
