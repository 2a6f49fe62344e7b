"""Presentation of results as console text, JSON objects and pictures. Views import results; results import no view."""
