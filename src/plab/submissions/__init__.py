"""Submissions to the leaderboard: recorded from any Gymnasium agent, packed, simulated again, shown.

``python -m plab.submit`` packs what a method found into one file, ``python -m plab.verify`` says what it
really scores, ``python -m plab.leaderboard`` makes a page of many. docs/submissions.md shows the way.
"""

from plab.submissions.recording import Recorder, VectorRecorder, record

__all__ = ["Recorder", "VectorRecorder", "record"]
