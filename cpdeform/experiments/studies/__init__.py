"""The further experiments of the paper: tables and figures that are made from the records of runs."""
