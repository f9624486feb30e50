"""States of runs in folders and archives of results: finished, running, interrupted, failed and missing."""

from plab.status.survey import NAMES, STATES, Survey, survey

__all__ = ["NAMES", "STATES", "Survey", "survey"]
