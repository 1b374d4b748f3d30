"""Where simulation and recordings differ, which unmodelled effect causes it, how far the gap shrinks."""
