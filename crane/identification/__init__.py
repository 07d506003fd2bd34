"""Parameters of closed machines from recordings."""
