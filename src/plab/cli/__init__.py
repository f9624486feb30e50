"""Command lines: each in a module of its own, with what they have in common: arguments, tables, answers."""
