"""Claim 7 of a certificate, checked in arithmetic of its own. Needs nothing but Python."""
