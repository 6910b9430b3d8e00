from pathlib import Path

from rosmop.tests.stories import Story, stories, tell


@stories(Path(__file__).parent / "stories.txt")
def test_story(story: Story) -> None:
    for step, lines in tell(story):
        assert tuple(lines) == step.expected, step.words
