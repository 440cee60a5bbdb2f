"""What is logged under each entity of a recording; paths are listed in `recorder`."""
