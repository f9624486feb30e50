"""Command-line interface: one module per command group, and shared arguments, tables and messages."""
