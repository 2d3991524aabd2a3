"""Light along rays: exactly and without noise (`direct`), or by path tracing on Mitsuba 3 (`path_tracer`)."""
