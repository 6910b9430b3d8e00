"""The quotas of the memory and of the disk that recordings use."""

from appliance.quotas.pool import Bounds
from appliance.quotas.table import HonestUse, QuotaRow

RECORDER_MEMORY = QuotaRow(
    thing="bytes of messages that the flight recorder keeps, divided among the relays",
    bounds=Bounds(whole=64 << 20, host=32 << 20, unknown=0, kept=0),
    at_limit="the oldest messages of the topic or host are overwritten",
    between="any host may use free memory; messages older than `recorder.before` are overwritten first",
    alarm="the recording lists what is missing",
    setting="recorder.memory (half of it for a host, a quarter for a topic)",
    margin=HonestUse(
        "40 topics of one machine with 1 KB at 50 Hz for ten seconds",
        20_000_000,
        beyond="large images are kept for a shorter time",
    ),
)
RECORDER_DISK = QuotaRow(
    thing="bytes of recordings",
    bounds=Bounds(whole=2 << 30, host=512 << 20, unknown=512 << 20, kept=512 << 20),
    at_limit="the host's oldest recording of the kind of trigger with most bytes is removed; a host starts at most six"
    " recordings an hour for each kind of trigger",
    between="no host displaces recordings of the robot, of operators or of the appliance, which get half of the whole"
    " back; two hosts besides the robot are recorded at once",
    counting="unknown: no rule names the host, or no host caused the recording; kept: for the robot, operators and"
    " the appliance",
    alarm="`recording removed`, `recording missed`; `detail.not_recorded` of the record",
    setting="recorder.disk (an eighth of it for one recording)",
    margin=HonestUse(
        "ten recordings of 30 MB by one host",
        300_000_000,
    ),
)

ROWS = (RECORDER_MEMORY, RECORDER_DISK)
