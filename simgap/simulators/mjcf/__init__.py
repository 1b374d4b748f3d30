"""MuJoCo models as simulators: what a log's columns are, what can be set, rollouts in batches."""
