"""Sweeps: many runs by one command, in batches that share a simulator, without losing or repeating any.

Nothing is imported here: the command line starts without torch.
"""
