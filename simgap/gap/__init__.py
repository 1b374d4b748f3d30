"""Where simulation and recording part, which unmodelled effect causes it, how far the gap shrinks."""
