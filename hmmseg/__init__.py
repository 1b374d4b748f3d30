"""From a task description and a recording to subtask spans."""

__version__ = "0.1.0"
