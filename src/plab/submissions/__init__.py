"""Submissions to the leaderboard: recorded from any Gymnasium agent, packed, simulated again, shown.

``python -m plab.submit`` packs a method's results into one file, ``python -m plab.verify`` simulates them
again, ``python -m plab.leaderboard`` makes a page of many. docs/submissions.md shows the way.
"""

from plab.submissions.recorder import Recorder, VectorRecorder, record

__all__ = ["Recorder", "VectorRecorder", "record"]
