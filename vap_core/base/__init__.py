"""What everything else stands on: errors, values, files. Imports nothing else of the package."""
