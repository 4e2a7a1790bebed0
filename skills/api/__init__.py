"""The HTTP service: every route parses a request, calls one library function and returns the response."""
