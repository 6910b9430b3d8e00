-- The index in ClickHouse, for fleets that outgrow PostgreSQL: a plan (docs/fleet.md, "Larger than one machine"). The
-- columns are those of ../rosrv_fleet/migrations/0001_segments_and_records.sql, and a test compares searches in both.
--
-- A collector inserts whole segments in batches. If it is killed before it has noted them, it inserts them again: rows
-- with equal keys replace each other when parts merge, and until then a search ignores them with LIMIT 1 BY.
CREATE TABLE record (
    day Date,                          -- of arrival, UTC; noted with the segment, so a repeated insert has the same
    robot String,
    log String,
    sequence Int64 CODEC(Delta, ZSTD),
    id String CODEC(ZSTD),
    time Int64 CODEC(Delta, ZSTD),     -- nanoseconds since the epoch
    version Int32,
    event LowCardinality(String),
    severity LowCardinality(String),
    decision LowCardinality(Nullable(String)),
    host Nullable(String),
    caller_id Nullable(String),
    category LowCardinality(Nullable(String)),
    resource Nullable(String),
    rule Nullable(String),
    rule_key Nullable(String),
    rule_file Nullable(String),
    rule_line Nullable(Int64),
    revision Nullable(Int64),
    reason String CODEC(ZSTD),
    duration_us Nullable(Int64),
    detail String CODEC(ZSTD),         -- JSON
    who Nullable(String),              -- `detail.who`
    INDEX of_host host TYPE bloom_filter,
    INDEX of_caller_id caller_id TYPE bloom_filter,
    INDEX of_resource resource TYPE bloom_filter,
    INDEX of_who who TYPE bloom_filter,
    INDEX of_event event TYPE set(100),
    INDEX of_decision decision TYPE set(10),
    INDEX of_severity severity TYPE set(10),
    PROJECTION of_robot (SELECT * ORDER BY robot, time)
)
ENGINE = ReplacingMergeTree
PARTITION BY day
ORDER BY (time, robot, id, log, sequence)
SETTINGS deduplicate_merge_projection_mode = 'rebuild';
