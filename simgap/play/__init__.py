"""The virtual blocks to be felt: fingertips on springs, worlds side by side, a session that is recorded."""
