"""Readers: task description, rig and trial files."""
