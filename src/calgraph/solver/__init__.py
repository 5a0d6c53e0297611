"""Minimization and sampling that know no sensor."""
