"""Submissions to the leaderboard: recorded from any Gymnasium agent, packed, simulated again, shown.

``plab submit`` packs a method's results into one file, ``plab verify`` simulates them again,
``plab leaderboard`` makes a page of many. docs/submissions.md shows the way.
"""

from plab.submissions.recorder import record

__all__ = ["record"]
