"""How well objects of one's own are found, and fetched among look-alikes, in a suite's episodes."""
