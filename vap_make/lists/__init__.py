"""How the episode lists of data/suites were drawn; notebook 01 draws them again and compares."""
