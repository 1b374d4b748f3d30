"""A diagnosis for people, from its JSON alone: in words, tables and figures."""
