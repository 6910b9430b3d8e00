-- The last reports of robots, and the rollouts of bundles.
CREATE TABLE bundle_robot (
    name text PRIMARY KEY,
    site text NOT NULL,
    robot_group text NOT NULL,
    report jsonb NOT NULL
);
CREATE INDEX bundle_robot_group ON bundle_robot (site, robot_group);
CREATE TABLE rollout (
    id bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    site text NOT NULL,
    robot_group text NOT NULL,
    document jsonb NOT NULL,
    state text NOT NULL,
    changed double precision NOT NULL
);
CREATE INDEX rollout_group ON rollout (site, robot_group, id DESC);
-- At most one rollout of a group runs at a time.
CREATE UNIQUE INDEX rollout_running ON rollout (site, robot_group) WHERE state = 'running';
CREATE TABLE bundle_timestamp (
    one boolean PRIMARY KEY DEFAULT true CHECK (one),
    version bigint NOT NULL,
    document bytea NOT NULL
);
