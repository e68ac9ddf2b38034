"""Clips of a recording, drawn without a screen."""
