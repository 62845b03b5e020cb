"""Parameters: one frozen dataclass for each stage, presets of them, and their TOML form.

No dictionaries, globals or setters; change a value with `dataclasses.replace`. Defaults are the
values of preset `default`; every constructor checks its ranges.
"""
