"""Names of topics, frames and sensors."""

from typing import Annotated

from pydantic import Field

# ROS limits names of topics to 255 characters, and file systems those of files; control characters would reach
# terminals and tables.
MAX_NAME_LENGTH = 255
CONTROL_CHARACTERS = r"\x00-\x1f\x7f-\x9f\u2028\u2029"
FrameName = Annotated[str, Field(max_length=MAX_NAME_LENGTH, pattern=rf"^[^{CONTROL_CHARACTERS}]*$")]
Name = Annotated[FrameName, Field(min_length=1)]
