"""States of runs in folders and archives of results: done, running, interrupted, failed, missing."""

from plab.status.survey import NAMES, STATES, Group, Run, Survey, survey

__all__ = ["NAMES", "STATES", "Group", "Run", "Survey", "survey"]
