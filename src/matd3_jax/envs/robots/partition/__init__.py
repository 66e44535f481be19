"""Who owns which joints and sees what: shared by all engines."""
