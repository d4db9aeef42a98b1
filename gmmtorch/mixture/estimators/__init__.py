"""Mixture estimators beyond plain EM, and sensor models."""
