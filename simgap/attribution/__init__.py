"""Which of many candidate effects explain a gap: statistics that know of no simulator and no hand."""
