"""Contact states of a task, and what each reveals."""
