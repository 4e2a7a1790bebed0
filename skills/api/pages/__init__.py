"""Web pages: each is one HTML document. Some need the site's scripts, others stand alone and run nothing."""
