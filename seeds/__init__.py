"""Initial content of an installation: the suture types, and synthetic surgeons with their recordings."""
