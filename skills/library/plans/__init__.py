"""Plans, playbacks, replay bags, a laboratory's errors, and tries."""
