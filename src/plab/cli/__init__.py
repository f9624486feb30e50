"""Command lines, one module each, and shared arguments, tables and messages."""
