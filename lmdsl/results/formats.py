"""What ``lmdsl export`` can write.

A format NAME is a module ``lmdsl/results/exports/NAME.py`` with ``write(result, lp, path)``, and a
line here. Nothing is imported before it is asked for.
"""

# For whom each format is, by name.
FORMATS = {
    "certificate": "to be checked alone",
    "c": "the controller, as a C header",
    "drn": "for Storm",
}
