"""Diagnosis of real against given simulated trials of an ordered task, without a contact model."""
