"""pdkit: a teaching and analysis kit around Policy Decorator (ICLR 2025)."""
__version__ = "0.1.0"
