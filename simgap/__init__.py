"""The virtual model, unmodelled effects and the diagnosis of the sim-to-real gap."""
