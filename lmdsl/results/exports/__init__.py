"""Files for readers that are not lmdsl: a certificate to be checked alone, and Storm's format."""

from lmdsl.results.exports.c import export_c
from lmdsl.results.exports.certificate import export_certificate
from lmdsl.results.exports.drn import export_drn

__all__ = ["export_c", "export_certificate", "export_drn"]
