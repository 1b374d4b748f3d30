"""A diagnosis for people, in words, tables and figures."""
