"""What every implementation of a protocol must keep, as tests to run on one's own.

    pytest --pyargs vap_core.contracts --detector my.module:Detector

docs/extend.md has the protocols, and what is tested of each.
"""
