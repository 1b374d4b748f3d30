"""The hand: kinematics and task-space signals."""
