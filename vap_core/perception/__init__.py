"""The frozen models of the method behind one-method protocols, and the stacks that they form."""
