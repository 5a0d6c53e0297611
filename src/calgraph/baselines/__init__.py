"""The papers' estimators, as published. Nothing on the default path imports from here."""
