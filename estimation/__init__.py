"""From subtask spans to block properties with uncertainty."""
