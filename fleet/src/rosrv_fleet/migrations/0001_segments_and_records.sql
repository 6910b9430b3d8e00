-- The index of the stored segments. Times are nanoseconds since the epoch, as in the audit log. Names and texts have
-- the collation "C": they are compared as bytes, and a prefix can use an index.

CREATE EXTENSION IF NOT EXISTS pg_trgm;

CREATE TABLE segment (
    robot text COLLATE "C" NOT NULL,
    log text COLLATE "C" NOT NULL,
    number bigint NOT NULL,           -- of the checkpoint that seals it
    hash text COLLATE "C" NOT NULL,   -- of the segment: its name
    first bigint NOT NULL,            -- sequences of its first and last record
    last bigint NOT NULL,
    first_time bigint,                -- times of its earliest and latest record; null: no records
    last_time bigint,
    received bigint NOT NULL,
    day date NOT NULL,                -- of `received`, UTC: the partition of its records
    PRIMARY KEY (robot, log, number, hash)
);
CREATE INDEX segment_day ON segment (day, first_time, last_time);

-- Partitions are the days of *arrival*: a robot whose clock is wrong cannot create partitions. A search finds the days
-- of a time range in `segment`.
CREATE TABLE record (
    day date NOT NULL,
    robot text COLLATE "C" NOT NULL,
    log text COLLATE "C" NOT NULL,
    sequence bigint NOT NULL,
    id text COLLATE "C" NOT NULL,
    time bigint NOT NULL,
    version integer NOT NULL,
    event text COLLATE "C" NOT NULL,
    severity text COLLATE "C" NOT NULL,
    decision text COLLATE "C",
    host text COLLATE "C",
    caller_id text COLLATE "C",
    category text COLLATE "C",
    resource text COLLATE "C",
    rule text COLLATE "C",
    rule_key text COLLATE "C",
    rule_file text COLLATE "C",
    rule_line bigint,
    revision bigint,
    reason text COLLATE "C" NOT NULL,
    duration_us bigint,
    detail text COLLATE "C" NOT NULL,  -- JSON
    who text COLLATE "C"               -- `detail.who`
) PARTITION BY RANGE (day);

-- Every index ends with the order of a search, so that a page needs no sort.
CREATE INDEX record_time ON record (time, robot, id);
CREATE INDEX record_robot ON record (robot, time, id);
CREATE INDEX record_host ON record (host, time, robot, id) WHERE host IS NOT NULL;
CREATE INDEX record_caller_id ON record (caller_id, time, robot, id) WHERE caller_id IS NOT NULL;
CREATE INDEX record_resource ON record (resource, time, robot, id) WHERE resource IS NOT NULL;
CREATE INDEX record_event ON record (event, time, robot, id);
CREATE INDEX record_decision ON record (decision, time, robot, id) WHERE decision <> 'allow';
CREATE INDEX record_alert ON record (time, robot, id) WHERE severity IN ('warning', 'alarm');
CREATE INDEX record_who ON record (who, time, robot, id) WHERE who IS NOT NULL;
CREATE INDEX record_words ON record USING gin ((
    coalesce(host, '') || ' ' || coalesce(caller_id, '') || ' ' || coalesce(resource, '') || ' ' ||
    coalesce(rule, '') || ' ' || reason || ' ' || detail) gin_trgm_ops);
