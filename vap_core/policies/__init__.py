"""Everything that maps images, text and proprioception to chunks of actions."""
