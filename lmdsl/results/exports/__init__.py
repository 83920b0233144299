"""Files for readers that are not lmdsl: certificates, controllers, finite models, tables, LPs."""

from lmdsl.results.exports.c import export_c
from lmdsl.results.exports.certificate import export_certificate
from lmdsl.results.exports.csv import export_csv
from lmdsl.results.exports.drn import export_drn
from lmdsl.results.exports.onnx import export_onnx
from lmdsl.results.exports.umb import export_umb

__all__ = [
    "export_c",
    "export_certificate",
    "export_csv",
    "export_drn",
    "export_onnx",
    "export_umb",
]
