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
INSERT INTO "incarnation" VALUES('442d75aa9ccc44c3bfac275b98a4672a','/voice','127.0.0.1','http://127.0.0.1:37881/','127.0.0.1',19211,19212,0,'live',1.79544275892927360531e+09);
INSERT INTO "incarnation" VALUES('60f515ecdb1229c1a760332963f40190','/rosout','127.0.0.1','http://127.0.0.1:37631/','127.0.0.1',19205,19206,1,'live',1.7954427584925332069e+09);
INSERT INTO "incarnation" VALUES('9d5a93cf879d51292496cecfbae4e2ed','/negator','127.0.0.1','http://127.0.0.1:45103/','127.0.0.1',19214,19215,0,'live',1.79544275939897346495e+09);
INSERT INTO "incarnation" VALUES('9f4dd0f2e79feb7c9e46c78c89fa3265','/ears','127.0.0.1','http://127.0.0.1:43711/','127.0.0.1',19208,19209,0,'live',1.79544275859452199931e+09);
INSERT INTO "incarnation" VALUES('b29a98fccf504a418243ea373298afbd','/asker','127.0.0.1','http://127.0.0.1:44209/','127.0.0.1',19217,19218,0,'live',1.79544275974412178989e+09);
CREATE TABLE monitor_revision (
    revision INTEGER PRIMARY KEY, sources TEXT NOT NULL, loaded REAL NOT NULL, who TEXT NOT NULL, note TEXT NOT NULL
);
INSERT INTO "monitor_revision" VALUES(1,'{"files": {"diary.rv": "// Counts what passes by.\ndiary() {\n    int seen = 0;\n\n    event heard() /chatter std_msgs/String ''{}'' {\n        seen += 1;\n    }\n}\n"}, "definitions": {}}',1.79544276787626314161e+09,'operator','count');
CREATE TABLE parameter_change (number INTEGER PRIMARY KEY, key TEXT NOT NULL, value BLOB);
CREATE TABLE parameter_owner (key TEXT PRIMARY KEY, host TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE parameters (id INTEGER PRIMARY KEY CHECK (id = 1), tree BLOB NOT NULL);
INSERT INTO "parameters" VALUES(1,X'84A672756E5F6964D92430313930323639342D653734372D313166312D623036312D303266633030303030303031A9726F7364697374726FA744656269616E0AAA726F7376657273696F6EA8312E31352E31350AA46B6570742A');
CREATE TABLE permission (
    key TEXT NOT NULL, kind TEXT NOT NULL, resource TEXT NOT NULL, host TEXT NOT NULL, caller_id TEXT NOT NULL,
    PRIMARY KEY (key, kind, resource, host, caller_id)
) WITHOUT ROWID;
INSERT INTO "permission" VALUES('442d75aa9ccc44c3bfac275b98a4672a','topic','/chatter','127.0.0.1','/ears');
INSERT INTO "permission" VALUES('442d75aa9ccc44c3bfac275b98a4672a','topic','/rosout','127.0.0.1','/rosout');
INSERT INTO "permission" VALUES('9d5a93cf879d51292496cecfbae4e2ed','service','/negate','127.0.0.1','/asker');
INSERT INTO "permission" VALUES('9d5a93cf879d51292496cecfbae4e2ed','topic','/rosout','127.0.0.1','/rosout');
INSERT INTO "permission" VALUES('9f4dd0f2e79feb7c9e46c78c89fa3265','topic','/rosout','127.0.0.1','/rosout');
INSERT INTO "permission" VALUES('b29a98fccf504a418243ea373298afbd','topic','/rosout','127.0.0.1','/rosout');
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
','/etc/rosrv/policy.ini',1.79544275799874114988e+09,'disk','read at start');
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
','revision 2',1.7954427606351978779e+09,'first','posted');
CREATE TABLE registration (
    key TEXT NOT NULL, kind TEXT NOT NULL, resource TEXT NOT NULL, detail TEXT NOT NULL,
    ordinal INTEGER NOT NULL, PRIMARY KEY (key, kind, resource)
) WITHOUT ROWID;
INSERT INTO "registration" VALUES('442d75aa9ccc44c3bfac275b98a4672a','publication','/chatter','std_msgs/String',12);
INSERT INTO "registration" VALUES('442d75aa9ccc44c3bfac275b98a4672a','publication','/rosout','rosgraph_msgs/Log',9);
INSERT INTO "registration" VALUES('442d75aa9ccc44c3bfac275b98a4672a','service','/voice/get_loggers','45769',10);
INSERT INTO "registration" VALUES('442d75aa9ccc44c3bfac275b98a4672a','service','/voice/set_logger_level','45769',11);
INSERT INTO "registration" VALUES('60f515ecdb1229c1a760332963f40190','publication','/rosout_agg','rosgraph_msgs/Log',3);
INSERT INTO "registration" VALUES('60f515ecdb1229c1a760332963f40190','service','/rosout/get_loggers','48197',1);
INSERT INTO "registration" VALUES('60f515ecdb1229c1a760332963f40190','service','/rosout/set_logger_level','48197',2);
INSERT INTO "registration" VALUES('60f515ecdb1229c1a760332963f40190','subscription','/rosout','rosgraph_msgs/Log',4);
INSERT INTO "registration" VALUES('9d5a93cf879d51292496cecfbae4e2ed','publication','/rosout','rosgraph_msgs/Log',13);
INSERT INTO "registration" VALUES('9d5a93cf879d51292496cecfbae4e2ed','service','/negate','33367',16);
INSERT INTO "registration" VALUES('9d5a93cf879d51292496cecfbae4e2ed','service','/negator/get_loggers','33367',14);
INSERT INTO "registration" VALUES('9d5a93cf879d51292496cecfbae4e2ed','service','/negator/set_logger_level','33367',15);
INSERT INTO "registration" VALUES('9f4dd0f2e79feb7c9e46c78c89fa3265','publication','/rosout','rosgraph_msgs/Log',5);
INSERT INTO "registration" VALUES('9f4dd0f2e79feb7c9e46c78c89fa3265','service','/ears/get_loggers','34627',6);
INSERT INTO "registration" VALUES('9f4dd0f2e79feb7c9e46c78c89fa3265','service','/ears/set_logger_level','34627',7);
INSERT INTO "registration" VALUES('9f4dd0f2e79feb7c9e46c78c89fa3265','subscription','/chatter','std_msgs/String',8);
INSERT INTO "registration" VALUES('b29a98fccf504a418243ea373298afbd','publication','/rosout','rosgraph_msgs/Log',17);
INSERT INTO "registration" VALUES('b29a98fccf504a418243ea373298afbd','service','/asker/get_loggers','43365',18);
INSERT INTO "registration" VALUES('b29a98fccf504a418243ea373298afbd','service','/asker/set_logger_level','43365',19);
CREATE TABLE relay_port (
    key TEXT NOT NULL, relay INTEGER NOT NULL, port INTEGER NOT NULL, PRIMARY KEY (key, relay)
) WITHOUT ROWID;
INSERT INTO "relay_port" VALUES('442d75aa9ccc44c3bfac275b98a4672a',1,19213);
INSERT INTO "relay_port" VALUES('60f515ecdb1229c1a760332963f40190',1,19207);
INSERT INTO "relay_port" VALUES('9d5a93cf879d51292496cecfbae4e2ed',1,19216);
INSERT INTO "relay_port" VALUES('9f4dd0f2e79feb7c9e46c78c89fa3265',1,19210);
INSERT INTO "relay_port" VALUES('b29a98fccf504a418243ea373298afbd',1,19219);
CREATE TABLE revocation (
    serial TEXT PRIMARY KEY, name TEXT NOT NULL, moment REAL NOT NULL, expires REAL NOT NULL
) WITHOUT ROWID;
CREATE TABLE revoked_certificate (serial TEXT PRIMARY KEY, moment REAL NOT NULL) WITHOUT ROWID;
CREATE TABLE setting (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
INSERT INTO "setting" VALUES('confirm','');
INSERT INTO "setting" VALUES('first token untold','');
INSERT INTO "setting" VALUES('monitor files of the folder','[]');
INSERT INTO "setting" VALUES('relays','{"relays": 2, "files": [["diary.rv", 0]], "resources": [["topic", "/chatter", 0]]}');
CREATE TABLE token (
    id TEXT PRIMARY KEY, name TEXT NOT NULL, role TEXT NOT NULL, salt BLOB NOT NULL, hash BLOB NOT NULL,
    created REAL NOT NULL, expires REAL NOT NULL, revoked REAL
) WITHOUT ROWID;
INSERT INTO "token" VALUES('2b2081cdf418','first','admin',X'FCC0656FA2C5F493211178E5FD08D011',X'F5ED69468FEC187F8778A6648FDC4B13AB0116E97C3D2CBDF114739458657D67',1.79544275801681566234e+09,1.80321875801681566235e+09,NULL);
INSERT INTO "token" VALUES('9184b3284814','gone','viewer',X'5A0C0AED75DB4D9793898AB6966739D4',X'7C10D7D1C766A197046EE45B045128E0913A3087EEEDEFD7BB89C6615680AF05',1.79544276211775422091e+09,1.80321876211775422096e+09,1.79544276337501239769e+09);
INSERT INTO "token" VALUES('fa602af14610','reader','viewer',X'8FA08E9F6002ED445C31216899AE6CDE',X'ACBC67EF0E0DCAEE88A547E53002A4C693C4BE07684221D098ECF9C175B8A96D',1.79544276120813035965e+09,1.80321876120813035966e+09,NULL);
CREATE TABLE token_keys (
    id TEXT PRIMARY KEY, reading BLOB NOT NULL, verifying BLOB NOT NULL
) WITHOUT ROWID;
INSERT INTO "token_keys" VALUES('2b2081cdf418',X'DC1CD9C460EE671D0031798D6FE24A18DD2FE63A87BEE3FDB63CB466E7E54A14',X'B38FC77823EF5F248A7BDF33E473919238AD2BF495CB481BA31AAD7A8093C597');
INSERT INTO "token_keys" VALUES('9184b3284814',X'EB20782E6E471AC08AB9963DEF168BF3D7176C58376226BB7FC97C305FB206BB',X'D903FBA826342DFE089C8F672E3F6EE4A4C908E22FE377E00A3711CDFD7E95AB');
INSERT INTO "token_keys" VALUES('fa602af14610',X'2993FD721B7EB1C9CBC2FA4740B852A98EFB87253459E660DE08481E3677AEDC',X'8AEA093FBA7A89F221ECA27E4B2BD2084046917FDB30CEBD2C8706C41D64130E');
COMMIT;
