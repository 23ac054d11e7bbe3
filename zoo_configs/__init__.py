"""Hyperparameters, one YAML file per algorithm. A package only so that installs carry the files."""
