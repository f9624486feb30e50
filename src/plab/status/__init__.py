"""What is done, running, failed and missing in folders and archives of results."""

from plab.status.survey import NAMES, STATES, Group, Run, Survey, survey

__all__ = ["NAMES", "STATES", "Group", "Run", "Survey", "survey"]
