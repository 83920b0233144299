"""What ``lmdsl export`` can write.

A format NAME is a module ``lmdsl/results/exports/NAME.py`` with ``write(result, lp, path)``, and a
line here. Nothing is imported before it is asked for.
"""

# For whom each format is, by name.
FORMATS = {
    "certificate": "to be checked alone",
    "c": "the controller, as a C header",
    "onnx": "the controller, as a graph for ONNX Runtime",
    "csv": "a table of all cells",
    "drn": "for Storm",
    "umb": "for Storm, PRISM and Modest",
    "mps": "the LP, for any LP solver",
}
