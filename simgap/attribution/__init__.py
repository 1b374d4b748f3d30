"""Which of many candidate effects explain a gap: mathematics that knows of no simulator and no hand."""
