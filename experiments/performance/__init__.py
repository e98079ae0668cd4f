"""Run time, by one command each: see the README."""
