"""What an empty installation starts with: the suture types, and synthetic surgeons with their recordings."""
