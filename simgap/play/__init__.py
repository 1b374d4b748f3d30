"""Virtual blocks to be felt: fingertips on springs, two worlds side by side, a recorded session."""
