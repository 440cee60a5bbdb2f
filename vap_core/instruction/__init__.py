"""Personalised instructions: find "my cup", and rewrite it to "the red cup" (P 3.3).

A parser is any function `(text, categories) -> Instruction`. `parse` is the deterministic rule of
the paper's main results; `parsers.load_parser` gives it, the offline parser of implicit references
(`embedding`), and any chat endpoint (`chat`). Whom "my" means is in `owners`.
"""

from vap_core.instruction.rule import Parser as Parser
from vap_core.instruction.rule import leading_category as leading_category
from vap_core.instruction.rule import parse as parse
from vap_core.instruction.rule import rewrite as rewrite
from vap_core.instruction.rule import unite as unite
