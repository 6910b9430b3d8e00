"""Define the types of settings with a unit.

pydantic reads the metadata of these types; msgspec and the users of a setting see only the plain type.
"""

from typing import Annotated

from pydantic import ByteSize, Field, GetPydanticSchema

BYTES = GetPydanticSchema(lambda _source, handler: handler(ByteSize))
Seconds = Annotated[float, Field(gt=0, le=86_400 * 365, allow_inf_nan=False)]
Milliseconds = Annotated[float, Field(ge=1.0, le=1000.0, allow_inf_nan=False)]
Count = Annotated[int, Field(gt=0)]
Size = Annotated[int, BYTES, Field(gt=0)]
SizeOfMebibytes = Annotated[int, BYTES, Field(ge=1 << 20)]  # at least 1 MiB
WithinAnHour = Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)]
