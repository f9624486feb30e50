"""Sweeps: execution of many runs in batches that share a simulator.

Nothing is imported here, so that the command line starts without torch.
"""
