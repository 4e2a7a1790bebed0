"""Pages for people: one HTML document each, with everything in it and nothing that runs."""
