"""A complete set of parts that computes in milliseconds, to test what puts parts together."""
