"""How well parsers find the object that an instruction means (P tab:llm_parser)."""
