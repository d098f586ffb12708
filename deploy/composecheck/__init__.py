"""The parts of compose_check.py: an engine, the images it lacks, the stack under test, what is looked at."""
