"""Words in square brackets arrive: Rich takes them for markup wherever it is allowed to."""

from rich.table import Table

from blinkgl.machine.terminal import plain_column, plain_console, say


def test_texts_tables_titles_and_bars_keep_their_brackets(capsys):
    console = plain_console(width=120)
    table = Table(title="out/run[1]")
    table.add_column("column [bold]")
    table.add_row("cell [cluster] [/red]")
    console.print(table)
    console.print("path/[red]/x", soft_wrap=True)
    say(console, "path/:bug:/x " + "y" * 200)
    out = capsys.readouterr().out
    assert all(
        text in out
        for text in (
            "out/run[1]",
            "column [bold]",
            "cell [cluster] [/red]",
            "path/[red]/x",
            "path/:bug:/x " + "y" * 200,
        )
    )

    class Task:
        description = "data[train]/a"

    assert plain_column("{task.description}").render(Task()).plain == "data[train]/a"
