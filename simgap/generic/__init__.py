"""Diagnosis of real against given simulated trials of a plain ordered task, without a contact model."""
