"""What commands print: their help is wrapped by the terminal, not by the source."""

from epipole.flows.command_line.options import help_text


def test_each_paragraph_of_help_is_one_line():
    def command():
        """Do a thing.

        This paragraph has
        two lines.

        The last one.
        """

    assert help_text(command) == "Do a thing.\n\nThis paragraph has two lines.\n\nThe last one."
