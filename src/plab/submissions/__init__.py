"""Submissions to the leaderboard: recording, packing, verification and display.

``plab submit`` packs a method's results into one file, ``plab verify`` simulates them again, ``plab
leaderboard`` generates a page; see docs/submissions.md.
"""

from plab.submissions.verifying import record

__all__ = ["record"]
