"""The estimators of MSG-Cal as published."""
