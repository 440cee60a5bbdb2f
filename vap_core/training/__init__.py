"""Training of every shipped part; every training resumes after an interruption."""
