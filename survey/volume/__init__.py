"""Radiance fields over the photographs of a finished run: trained, rendered, extracted and compared."""
