"""The offline stack: small heads, trained on rendered generic objects, on frozen features."""
