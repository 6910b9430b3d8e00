BEGIN TRANSACTION;
CREATE TABLE enrolment_token (
    name TEXT PRIMARY KEY, id TEXT NOT NULL, hash BLOB NOT NULL, created REAL NOT NULL, expires REAL NOT NULL,
    address TEXT NOT NULL, days REAL NOT NULL, kit TEXT NOT NULL, who TEXT NOT NULL
) WITHOUT ROWID;
CREATE TABLE host (
    name TEXT PRIMARY KEY, address TEXT NOT NULL UNIQUE, serial TEXT NOT NULL, expires REAL NOT NULL,
    enrolled REAL NOT NULL, revoked REAL
) WITHOUT ROWID;
CREATE TABLE host_certificate (
    name TEXT PRIMARY KEY, made REAL NOT NULL, certificate TEXT NOT NULL,
    next_serial TEXT, next_expires REAL, next_certificate TEXT
) WITHOUT ROWID;
CREATE TABLE host_ports (
    name TEXT PRIMARY KEY, state TEXT NOT NULL, open TEXT NOT NULL, checked REAL NOT NULL, who TEXT NOT NULL
) WITHOUT ROWID;
CREATE TABLE incarnation (
    key TEXT PRIMARY KEY, name TEXT NOT NULL, host TEXT NOT NULL, api TEXT NOT NULL, told TEXT NOT NULL,
    outer_port INTEGER NOT NULL, relay_port INTEGER NOT NULL, own INTEGER NOT NULL,
    life TEXT NOT NULL, changed REAL NOT NULL
) WITHOUT ROWID;
INSERT INTO "incarnation" VALUES('19d0466f72a65c89c91ef84b3ad49536','/voice','127.0.0.1','http://127.0.0.1:40619/voice','127.0.0.1',19010,19011,0,'live',510.869055205);
INSERT INTO "incarnation" VALUES('40cc64a106c9c4fa05d7890b2a4ec019','/ears','127.0.0.1','http://127.0.0.1:40619/ears','127.0.0.1',19013,19014,0,'live',510.871082096);
INSERT INTO "incarnation" VALUES('4d74f367443ee883f158de9d5e4bfdd9','/asker','127.0.0.1','http://127.0.0.1:40619/asker','127.0.0.1',19019,19020,0,'live',510.888301843);
INSERT INTO "incarnation" VALUES('722c8c01d76ae25276f4e1be9cea8cea','/rosout','127.0.0.1','http://127.0.0.1:44207/','127.0.0.1',19007,19008,1,'live',508.246328948);
INSERT INTO "incarnation" VALUES('845891c99411def650b9418c89270cc3','/negator','127.0.0.1','http://127.0.0.1:40619/negator','127.0.0.1',19016,19017,0,'live',510.872410517);
CREATE TABLE monitor_revision (
    revision INTEGER PRIMARY KEY, sources TEXT NOT NULL, loaded REAL NOT NULL, who TEXT NOT NULL, note TEXT NOT NULL
);
INSERT INTO "monitor_revision" VALUES(1,'{"files":{"diary.rv":"\n\ndiary() {\n  int heard = 0;\n\n  event said(string line) /chatter std_msgs/String ''{data:line}'' {\n    heard = heard + 1;\n  }\n}\n"},"definitions":{},"signatures":{}}',1.79572053939711451537e+09,'operator','loaded');
CREATE TABLE parameter_change (number INTEGER PRIMARY KEY, key TEXT NOT NULL, value BLOB);
CREATE TABLE parameter_owner (key TEXT PRIMARY KEY, host TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE parameters (id INTEGER PRIMARY KEY CHECK (id = 1), tree BLOB NOT NULL);
INSERT INTO "parameters" VALUES(1,X'84A672756E5F6964D92463323261626338382D653963642D313166312D613961662D303266633030303030303031A9726F7364697374726FA744656269616E0AAA726F7376657273696F6EA8312E31352E31350AA46B6570742A');
CREATE TABLE permission (
    key TEXT NOT NULL, kind TEXT NOT NULL, resource TEXT NOT NULL, host TEXT NOT NULL, caller_id TEXT NOT NULL,
    PRIMARY KEY (key, kind, resource, host, caller_id)
) WITHOUT ROWID;
INSERT INTO "permission" VALUES('845891c99411def650b9418c89270cc3','service','/negate','127.0.0.1','/asker');
CREATE TABLE policy_revision (
    revision INTEGER PRIMARY KEY, text TEXT NOT NULL, file TEXT NOT NULL, loaded REAL NOT NULL,
    who TEXT NOT NULL, note TEXT NOT NULL
);
INSERT INTO "policy_revision" VALUES(1,'[Groups]
robot1 = 127.0.0.1
[Nodes]
default = robot1
[Publishers]
default = robot1
[Subscribers]
default = robot1
[Commands]
default = robot1
','/etc/rosrv/policy.ini',1.7957205360229508877e+09,'disk','read at start');
INSERT INTO "policy_revision" VALUES(2,'[Groups]
robot1 = 127.0.0.1
[Nodes]
default = robot1
[Publishers]
default = robot1
[Subscribers]
default = robot1
/secret =
[Commands]
default = robot1
','revision 2',1.79572054092585539812e+09,'first','posted');
CREATE TABLE policy_signature (revision INTEGER PRIMARY KEY, signature TEXT NOT NULL);
INSERT INTO "policy_signature" VALUES(1,'');
INSERT INTO "policy_signature" VALUES(2,'');
CREATE TABLE registration (
    key TEXT NOT NULL, kind TEXT NOT NULL, resource TEXT NOT NULL, detail TEXT NOT NULL,
    ordinal INTEGER NOT NULL, PRIMARY KEY (key, kind, resource)
) WITHOUT ROWID;
INSERT INTO "registration" VALUES('19d0466f72a65c89c91ef84b3ad49536','publication','/chatter','std_msgs/String',5);
INSERT INTO "registration" VALUES('40cc64a106c9c4fa05d7890b2a4ec019','subscription','/chatter','std_msgs/String',6);
INSERT INTO "registration" VALUES('4d74f367443ee883f158de9d5e4bfdd9','subscription','/chatter2','std_msgs/String',8);
INSERT INTO "registration" VALUES('722c8c01d76ae25276f4e1be9cea8cea','publication','/rosout_agg','rosgraph_msgs/Log',3);
INSERT INTO "registration" VALUES('722c8c01d76ae25276f4e1be9cea8cea','service','/rosout/get_loggers','34567',1);
INSERT INTO "registration" VALUES('722c8c01d76ae25276f4e1be9cea8cea','service','/rosout/set_logger_level','34567',2);
INSERT INTO "registration" VALUES('722c8c01d76ae25276f4e1be9cea8cea','subscription','/rosout','rosgraph_msgs/Log',4);
INSERT INTO "registration" VALUES('845891c99411def650b9418c89270cc3','service','/negate','34567',7);
CREATE TABLE relay_port (
    key TEXT NOT NULL, relay INTEGER NOT NULL, port INTEGER NOT NULL, PRIMARY KEY (key, relay)
) WITHOUT ROWID;
INSERT INTO "relay_port" VALUES('19d0466f72a65c89c91ef84b3ad49536',1,19012);
INSERT INTO "relay_port" VALUES('40cc64a106c9c4fa05d7890b2a4ec019',1,19015);
INSERT INTO "relay_port" VALUES('4d74f367443ee883f158de9d5e4bfdd9',1,19021);
INSERT INTO "relay_port" VALUES('722c8c01d76ae25276f4e1be9cea8cea',1,19009);
INSERT INTO "relay_port" VALUES('845891c99411def650b9418c89270cc3',1,19018);
CREATE TABLE revocation (
    serial TEXT PRIMARY KEY, name TEXT NOT NULL, moment REAL NOT NULL, expires REAL NOT NULL
) WITHOUT ROWID;
CREATE TABLE revoked_certificate (serial TEXT PRIMARY KEY, moment REAL NOT NULL) WITHOUT ROWID;
CREATE TABLE setting (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
INSERT INTO "setting" VALUES('confirm','');
INSERT INTO "setting" VALUES('confirm monitors','');
INSERT INTO "setting" VALUES('first token untold','');
INSERT INTO "setting" VALUES('monitor returns','{}');
INSERT INTO "setting" VALUES('monitor switches','{}');
INSERT INTO "setting" VALUES('relays','{"relays": 2, "files": [["diary.rv", 0]], "resources": [["topic", "/chatter", 0]]}');
CREATE TABLE token (
    id TEXT PRIMARY KEY, name TEXT NOT NULL, role TEXT NOT NULL, salt BLOB NOT NULL, hash BLOB NOT NULL,
    created REAL NOT NULL, expires REAL NOT NULL, revoked REAL
) WITHOUT ROWID;
INSERT INTO "token" VALUES('1058b293e4a3','first','admin',X'785F727D35E45F82C94D5435010F0314',X'0000000000000000000000000000000000000000000000000000000000000000',1.79572053603669500344e+09,4102444800.0,NULL);
INSERT INTO "token" VALUES('712bb6fce305','reader','viewer',X'3F4D0A5B874BFC35F4568935B147F413',X'0000000000000000000000000000000000000000000000000000000000000000',1.79572054096593427662e+09,4102444800.0,NULL);
INSERT INTO "token" VALUES('7611dd51bf37','gone','viewer',X'2A7718AAD7841B5098FB8D18DB1917DB',X'0000000000000000000000000000000000000000000000000000000000000000',1.79572054114360094064e+09,4102444800.0,1.7957205412554609775e+09);
CREATE TABLE token_keys (
    id TEXT PRIMARY KEY, reading BLOB NOT NULL, verifying BLOB NOT NULL
) WITHOUT ROWID;
INSERT INTO "token_keys" VALUES('1058b293e4a3',X'0000000000000000000000000000000000000000000000000000000000000000',X'0000000000000000000000000000000000000000000000000000000000000000');
INSERT INTO "token_keys" VALUES('712bb6fce305',X'0000000000000000000000000000000000000000000000000000000000000000',X'0000000000000000000000000000000000000000000000000000000000000000');
INSERT INTO "token_keys" VALUES('7611dd51bf37',X'0000000000000000000000000000000000000000000000000000000000000000',X'0000000000000000000000000000000000000000000000000000000000000000');
COMMIT;
