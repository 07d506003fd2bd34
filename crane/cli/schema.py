"""The command that prints the JSON Schema of machine files: schema."""

from crane.cli.shared import app


@app.command()
def schema() -> None:
    """Print the JSON Schema of machine files, by which editors complete and check them."""
    from crane.formats.machine_file.json_schema import schema_text

    print(schema_text(), end="")
