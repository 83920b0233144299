"""The JSON Schema of problem files."""

from typing import Any

from pydantic.json_schema import GenerateJsonSchema


class FileSchema(GenerateJsonSchema):
    """The schema of what a file may hold: no null."""

    def nullable_schema(self, schema: Any) -> Any:
        """Leave null out."""
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> Any:
        """Leave out a default that is null."""
        generated = super().default_schema(schema)
        if generated.get("default", 0) is None:
            del generated["default"]
        return generated
