"""Web viewer: live runs, replays of recorded runs, and export to a standalone HTML page.

Suggested reading order: ``snapshot`` (displayed state at one show time, as plain values), ``timeline`` and
``run_state`` (snapshots from a recording), ``surroundings`` (ground plane and initial view), ``scene`` with
its layers (3-D drawing), ``panel`` and ``charts`` (controls, images, plots), ``player`` (playback),
``server``, ``guard`` and ``messages`` (network access), ``live`` (runs started from the browser), ``page``
(standalone HTML page).
"""
