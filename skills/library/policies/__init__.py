"""Training, policy versions, releases, batches and policy cards."""
