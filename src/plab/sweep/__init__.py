"""Sweeps: batched execution of many runs that share a simulator.

Nothing is imported here, so that the command line starts without torch.
"""
