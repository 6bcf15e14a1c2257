"""Pictures and animations of run records."""
