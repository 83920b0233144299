"""Policies: evaluated, improved, ties broken."""
