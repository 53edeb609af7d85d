"""From an object map to motions: where things go, how to grasp them, how to move, and what to do if it fails.

Read in this order: ``types`` (what is planned with), ``planner`` (a whole task), ``pick_place`` (one object),
``execution`` (carrying it out). Grasps and placements rest on ``standing`` and ``sections``; motions on
``kinematics``, ``collision`` and ``trajectories``. ``robot`` is the interface to an arm, simulated or real.
"""
