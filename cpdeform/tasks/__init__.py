"""Tasks as data files, and the makers of their goals."""
