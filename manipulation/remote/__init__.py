"""The protocol ``Robot`` between two processes: ``server`` beside the robot, ``client`` beside the planner.

Read ``messages`` first: it defines everything that is sent.
"""
