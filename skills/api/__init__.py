"""The service over HTTP: a route parses, calls one library function, and answers."""
