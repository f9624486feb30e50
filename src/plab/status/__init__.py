"""States of runs in folders and archives of results: done, running, interrupted, failed, missing."""

from plab.status.survey import NAMES, STATES, Survey, survey

__all__ = ["NAMES", "STATES", "Survey", "survey"]
