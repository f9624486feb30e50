"""Planners: searches for a sequence of actions with many candidates, which a simulator tries together.

:mod:`plab.runners.planners.planner` has what they share.
"""
