"""Files of every command: tables read (CSV, TOML), JSON written, and where outputs may go."""
