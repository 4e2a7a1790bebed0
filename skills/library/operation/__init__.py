"""Jobs, history, backups, inspection, and the sweep."""
