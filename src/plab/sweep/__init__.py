"""Sweeps: many runs by one command, in batches that share a simulator, without losing or repeating any.

:mod:`plab.sweep.compose` makes the configurations, :mod:`plab.sweep.plan` puts those together that can run
together, :mod:`plab.sweep.carry` has them run; :mod:`plab.outcomes` says how each ended. Hydra's side is
in :mod:`hydra_plugins.plab_launcher`. Nothing is imported here: the command line starts without torch.
"""
