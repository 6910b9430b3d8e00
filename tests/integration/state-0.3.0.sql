BEGIN TRANSACTION;
CREATE TABLE appliance (
    key TEXT PRIMARY KEY, endpoint TEXT NOT NULL, pin TEXT NOT NULL, certificate TEXT NOT NULL, serial TEXT NOT NULL,
    expires REAL NOT NULL
) WITHOUT ROWID;
INSERT INTO "appliance" VALUES('abababababababababababababababababababababababababababababababab','10.0.0.2','cdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcd','-----BEGIN CERTIFICATE-----
MIIBPTCB5KADAgECAhRAVfDpRF9d+GE3eeCSS7xoAKZYNTAKBggqhkjOPQQDAjAW
MRQwEgYDVQQDDAtyb3NydiBob3N0czAgFw0yNjExMjYwMDAwMDBaGA8yMDk5MTIz
MTAwMDAwMFowFDESMBAGA1UEAwwJYXBwbGlhbmNlMFkwEwYHKoZIzj0CAQYIKoZI
zj0DAQcDQgAEZNWVXqcWENCwQB5g0la3wso3ISnNunfNr3YDpUaBLCW5siAhcGF6
+p73XaNPJr3E9WhboFhwhG8rhl2ZWC89maMQMA4wDAYDVR0TAQH/BAIwADAKBggq
hkjOPQQDAgNIADBFAiEArp+jVTtU4WPMbWDdZNCJNkvvbok0FAWBU6AhVFKPj3sC
IA9txnbN3tzJnCmg5Stl0nzWWxNP0U1arvMtTjWZCcKi
-----END CERTIFICATE-----
','4055f0e9445f5df8613779e0924bbc6800a65835',4102444800.0);
CREATE TABLE authority (
    id INTEGER PRIMARY KEY CHECK (id = 1), certificate TEXT NOT NULL, revocations TEXT NOT NULL, signed REAL NOT NULL
);
INSERT INTO "authority" VALUES(1,'-----BEGIN CERTIFICATE-----
MIIBQzCB6aADAgECAhQfeh0WpjSsNBpX7SmFhhvdRxCsLjAKBggqhkjOPQQDAjAW
MRQwEgYDVQQDDAtyb3NydiBob3N0czAgFw0yNjExMjYwMDAwMDBaGA8yMDk5MTIz
MTAwMDAwMFowFjEUMBIGA1UEAwwLcm9zcnYgaG9zdHMwWTATBgcqhkjOPQIBBggq
hkjOPQMBBwNCAARmitNU1NQIJ+hCqSdNi6HirGr1pHUW9oTy3zPoWHnbscCXHVsi
jYnGYs495PCb7t/5NCpWoRTQYpMc0zPHyzs6oxMwETAPBgNVHRMBAf8EBTADAQH/
MAoGCCqGSM49BAMCA0kAMEYCIQC46rsKgsG0fZPSi+J0r+0K3XBJO3dGG1YhW2H6
U0o+mQIhALJJaUl8wMVAiSHrgAZuqakBBwfXyIcldugjN+GAyuEq
-----END CERTIFICATE-----
','-----BEGIN X509 CRL-----
MIGfMEcCAQEwCgYIKoZIzj0EAwIwFjEUMBIGA1UEAwwLcm9zcnYgaG9zdHMXDTI2
MTEyNjAwMDAwMFoYDzIwOTkxMjMxMDAwMDAwWjAKBggqhkjOPQQDAgNIADBFAiEA
1Pv8M5TH83/+IoruWp6XMmQCQFJqTSKua67QScYeqh4CIAo7zpjzGt/+6vLN5Tnw
DleBy8lW4BcJBIeSrp0bUkDe
-----END X509 CRL-----
',1795733736.0);
CREATE TABLE door (
    name TEXT PRIMARY KEY, address TEXT NOT NULL UNIQUE, added REAL NOT NULL, removed REAL, slot INTEGER,
    port INTEGER, source TEXT NOT NULL
) WITHOUT ROWID;
INSERT INTO "door" VALUES('agent-1','198.19.240.3',1795733737.0,NULL,1,9091,'10.0.0.7/32');
INSERT INTO "door" VALUES('alice','198.19.240.2',1795733736.0,NULL,0,NULL,'');
INSERT INTO "door" VALUES('bob','198.19.240.4',1795733738.0,1795733745.0,NULL,NULL,'');
CREATE TABLE door_ticket (
    id TEXT PRIMARY KEY, door TEXT NOT NULL, hash BLOB NOT NULL, created REAL NOT NULL, expires REAL NOT NULL,
    who TEXT NOT NULL
) WITHOUT ROWID;
INSERT INTO "door_ticket" VALUES('0a1b2c3d4e5f','alice',X'0000000000000000000000000000000000000000000000000000000000000000',1795733736.0,4102444800.0,'first');
CREATE TABLE enrolment_token (
    name TEXT PRIMARY KEY, id TEXT NOT NULL, hash BLOB NOT NULL, created REAL NOT NULL, expires REAL NOT NULL,
    address TEXT NOT NULL, days REAL NOT NULL, kit TEXT NOT NULL, who TEXT NOT NULL
) WITHOUT ROWID;
INSERT INTO "enrolment_token" VALUES('robot3','0123456789ab',X'0000000000000000000000000000000000000000000000000000000000000000',1795733736.0,4102444800.0,'10.78.0.4',90.0,'{"endpoint": "10.0.0.2"}','first');
CREATE TABLE host (
    name TEXT PRIMARY KEY, address TEXT NOT NULL UNIQUE, serial TEXT NOT NULL, expires REAL NOT NULL,
    enrolled REAL NOT NULL, revoked REAL
) WITHOUT ROWID;
INSERT INTO "host" VALUES('away','10.78.0.3','4982e8a54e8bddf221172504cbc05d7f5499ad34',4102444800.0,1795733736.0,1795733796.0);
INSERT INTO "host" VALUES('robot2','10.78.0.2','5c666569ae3c8b6bfc1e2638824bc3a82b9815f5',4102444800.0,1795733736.0,NULL);
CREATE TABLE host_block (
    address TEXT PRIMARY KEY, since REAL NOT NULL, ends INTEGER, who TEXT NOT NULL, note TEXT NOT NULL
) WITHOUT ROWID;
INSERT INTO "host_block" VALUES('10.9.9.9',1.79582642777940130239e+09,NULL,'operator','lost');
CREATE TABLE host_certificate (
    name TEXT PRIMARY KEY, made REAL NOT NULL, certificate TEXT NOT NULL,
    next_serial TEXT, next_expires REAL, next_certificate TEXT
) WITHOUT ROWID;
INSERT INTO "host_certificate" VALUES('robot2',1795733736.0,'-----BEGIN CERTIFICATE-----
MIIBOjCB4aADAgECAhRcZmVprjyLa/weJjiCS8OoK5gV9TAKBggqhkjOPQQDAjAW
MRQwEgYDVQQDDAtyb3NydiBob3N0czAgFw0yNjExMjYwMDAwMDBaGA8yMDk5MTIz
MTAwMDAwMFowETEPMA0GA1UEAwwGcm9ib3QyMFkwEwYHKoZIzj0CAQYIKoZIzj0D
AQcDQgAENvTKQ1fZB0BfvzuMKpfny1AYs3de8T0bWo8xwpv/CYzk/XPx0fcHh3QP
Q7yUGAEo0q/GOrgB8ObOyjgiZzFYLKMQMA4wDAYDVR0TAQH/BAIwADAKBggqhkjO
PQQDAgNIADBFAiBTTiZGyBHBSyAAzh5OICDhnMjoEwR1hL1+z1fDoXT9lAIhAKGc
KRQU11K+RVA/5ysvUYgx5wciqu7wT/VP0QGnFXId
-----END CERTIFICATE-----
','23cc88d9de7c6c695223dbe89080ac541b7ee6fa',4102444800.0,'-----BEGIN CERTIFICATE-----
MIIBOjCB4aADAgECAhQjzIjZ3nxsaVIj2+iQgKxUG37m+jAKBggqhkjOPQQDAjAW
MRQwEgYDVQQDDAtyb3NydiBob3N0czAgFw0yNjExMjYwMDAwMDBaGA8yMDk5MTIz
MTAwMDAwMFowETEPMA0GA1UEAwwGcm9ib3QyMFkwEwYHKoZIzj0CAQYIKoZIzj0D
AQcDQgAEduA8hPyxleZXd+63R02qiposwTsurDKVxtz7YudbLEEsq79P8neYRFDT
ca0Eqwrh15ZLzKyxMLa+uAb8YUdEaaMQMA4wDAYDVR0TAQH/BAIwADAKBggqhkjO
PQQDAgNIADBFAiEA9akb1X3HHdeHKhKpxFxBnSis0VXOaSQ+RQUymO8+bS4CIA5P
7qUArsGdmCObmGKp6FWI4EfOJohJUm1leorzdPY3
-----END CERTIFICATE-----
');
CREATE TABLE host_ports (
    name TEXT PRIMARY KEY, state TEXT NOT NULL, open TEXT NOT NULL, checked REAL NOT NULL, who TEXT NOT NULL
) WITHOUT ROWID;
INSERT INTO "host_ports" VALUES('robot2','open','[11311, 40001]',1795733741.0,'first');
CREATE TABLE incarnation (
    key TEXT PRIMARY KEY, name TEXT NOT NULL, host TEXT NOT NULL, api TEXT NOT NULL, told TEXT NOT NULL,
    outer_port INTEGER NOT NULL, relay_port INTEGER NOT NULL, own INTEGER NOT NULL,
    life TEXT NOT NULL, changed REAL NOT NULL
) WITHOUT ROWID;
INSERT INTO "incarnation" VALUES('08e8381232a644bbf0d758b70dc48b73','/voice','127.0.0.1','http://127.0.0.1:36879/voice','127.0.0.1',19004,19005,0,'live',50610.286239417);
INSERT INTO "incarnation" VALUES('3c82b01dbf36c6674bf2f11c053247a7','/rosout','127.0.0.1','http://127.0.0.1:39839/','127.0.0.1',19001,19002,1,'live',50601.957615957);
INSERT INTO "incarnation" VALUES('7044b2937af1c5b3c6f0c166c616136d','/negator','127.0.0.1','http://127.0.0.1:36879/negator','127.0.0.1',19010,19011,0,'live',50610.332646639);
INSERT INTO "incarnation" VALUES('9b621e6289fc3ba77872bb8fda8b047c','/ears','127.0.0.1','http://127.0.0.1:36879/ears','127.0.0.1',19007,19008,0,'live',50610.320961704);
INSERT INTO "incarnation" VALUES('ad417cef9c6978cf5eeba7d5c740eb78','/asker','127.0.0.1','http://127.0.0.1:36879/asker','127.0.0.1',19013,19014,0,'live',50610.344304674);
CREATE TABLE journal (
    id INTEGER PRIMARY KEY CHECK (id = 1), epoch INTEGER NOT NULL, history TEXT NOT NULL, number INTEGER NOT NULL
);
INSERT INTO "journal" VALUES(1,0,'7cab9754ab61c889',77);
CREATE TABLE monitor_revision (
    revision INTEGER PRIMARY KEY, sources TEXT NOT NULL, loaded REAL NOT NULL, who TEXT NOT NULL, note TEXT NOT NULL
);
INSERT INTO "monitor_revision" VALUES(1,'{"files":{"diary.rv":"\ndiary() {\n  int heard = 0;\n\n  event said(string line) /chatter std_msgs/String ''{data:line}'' {\n    heard = heard + 1;\n  }\n}\n"},"definitions":{},"signatures":{},"topics":{}}',1.7958264272385118008e+09,'operator','loaded');
CREATE TABLE monitor_state (
    relay INTEGER PRIMARY KEY, epoch INTEGER NOT NULL, content BLOB NOT NULL
);
INSERT INTO "monitor_state" VALUES(0,1,X'00');
CREATE TABLE parameter_change (number INTEGER PRIMARY KEY, key TEXT NOT NULL, value BLOB);
INSERT INTO "parameter_change" VALUES(1,'/kept',X'2A');
INSERT INTO "parameter_change" VALUES(2,'/changed',X'07');
CREATE TABLE parameter_owner (key TEXT PRIMARY KEY, host TEXT NOT NULL) WITHOUT ROWID;
INSERT INTO "parameter_owner" VALUES('/changed','127.0.0.1');
CREATE TABLE parameters (id INTEGER PRIMARY KEY CHECK (id = 1), tree BLOB NOT NULL);
INSERT INTO "parameters" VALUES(1,X'83A672756E5F6964D92434393635653462302D656163342D313166312D623031312D303266633030303030303031A9726F7364697374726FA744656269616E0AAA726F7376657273696F6EA8312E31352E31350A');
CREATE TABLE permission (
    key TEXT NOT NULL, kind TEXT NOT NULL, resource TEXT NOT NULL, host TEXT NOT NULL, caller_id TEXT NOT NULL,
    PRIMARY KEY (key, kind, resource, host, caller_id)
) WITHOUT ROWID;
INSERT INTO "permission" VALUES('7044b2937af1c5b3c6f0c166c616136d','service','/negate','127.0.0.1','/asker');
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
','/etc/rosrv/policy.ini',1.79582641905735850332e+09,'disk','read at start');
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
','revision 2',1.79582642220973491675e+09,'first','posted');
CREATE TABLE policy_signature (revision INTEGER PRIMARY KEY, signature TEXT NOT NULL);
INSERT INTO "policy_signature" VALUES(1,'');
INSERT INTO "policy_signature" VALUES(2,'');
CREATE TABLE registration (
    key TEXT NOT NULL, kind TEXT NOT NULL, resource TEXT NOT NULL, detail TEXT NOT NULL,
    ordinal INTEGER NOT NULL, PRIMARY KEY (key, kind, resource)
) WITHOUT ROWID;
INSERT INTO "registration" VALUES('08e8381232a644bbf0d758b70dc48b73','publication','/chatter','std_msgs/String',5);
INSERT INTO "registration" VALUES('3c82b01dbf36c6674bf2f11c053247a7','publication','/rosout_agg','rosgraph_msgs/Log',3);
INSERT INTO "registration" VALUES('3c82b01dbf36c6674bf2f11c053247a7','service','/rosout/get_loggers','45511',1);
INSERT INTO "registration" VALUES('3c82b01dbf36c6674bf2f11c053247a7','service','/rosout/set_logger_level','45511',2);
INSERT INTO "registration" VALUES('3c82b01dbf36c6674bf2f11c053247a7','subscription','/rosout','rosgraph_msgs/Log',4);
INSERT INTO "registration" VALUES('7044b2937af1c5b3c6f0c166c616136d','service','/negate','34567',7);
INSERT INTO "registration" VALUES('9b621e6289fc3ba77872bb8fda8b047c','subscription','/chatter','std_msgs/String',6);
INSERT INTO "registration" VALUES('ad417cef9c6978cf5eeba7d5c740eb78','subscription','/chatter2','std_msgs/String',8);
CREATE TABLE relay_port (
    key TEXT NOT NULL, relay INTEGER NOT NULL, port INTEGER NOT NULL, PRIMARY KEY (key, relay)
) WITHOUT ROWID;
INSERT INTO "relay_port" VALUES('08e8381232a644bbf0d758b70dc48b73',1,19006);
INSERT INTO "relay_port" VALUES('3c82b01dbf36c6674bf2f11c053247a7',1,19003);
INSERT INTO "relay_port" VALUES('7044b2937af1c5b3c6f0c166c616136d',1,19012);
INSERT INTO "relay_port" VALUES('9b621e6289fc3ba77872bb8fda8b047c',1,19009);
INSERT INTO "relay_port" VALUES('ad417cef9c6978cf5eeba7d5c740eb78',1,19015);
CREATE TABLE revocation (
    serial TEXT PRIMARY KEY, name TEXT NOT NULL, moment REAL NOT NULL, expires REAL NOT NULL
) WITHOUT ROWID;
INSERT INTO "revocation" VALUES('4982e8a54e8bddf221172504cbc05d7f5499ad34','away',1795733796.0,4102444800.0);
CREATE TABLE revoked_certificate (serial TEXT PRIMARY KEY, moment REAL NOT NULL) WITHOUT ROWID;
INSERT INTO "revoked_certificate" VALUES('00aa',1795733736.0);
CREATE TABLE setting (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
INSERT INTO "setting" VALUES('certificate of REST','{"":"db51bcbf5b539656a313142c2a296f31f765f8336a8f0f69986897c4504ffc2e"}');
INSERT INTO "setting" VALUES('confirm','');
INSERT INTO "setting" VALUES('confirm monitors','');
INSERT INTO "setting" VALUES('declared hosts','# The intended hosts with IPsec tunnels (docs/tunnels.md). Read at start and by `rosrv host reload`, never written:
# enrolled hosts are in the state, and `rosrv host list` shows differences from this file.
#
# hosts:
#   - name: ocu-1               # `host:ocu-1` in the policy; enrol it: rosrv host add ocu-1 --token
#     address: 10.113.11.20     # optional: the virtual address kept for it, in the pool of `ipsec:`
#     groups: [operators]       # optional: rosrv host list --group operators
#     tunnel: true              # false: enrolled or not, its tunnel stays closed
hosts: []
');
INSERT INTO "setting" VALUES('first token untold','');
INSERT INTO "setting" VALUES('monitor given','{}');
INSERT INTO "setting" VALUES('monitor returns','{}');
INSERT INTO "setting" VALUES('monitor switches','{}');
INSERT INTO "setting" VALUES('relays','{"relays": 2, "files": [["diary.rv", 0]], "resources": [["topic", "/chatter", 0]]}');
INSERT INTO "setting" VALUES('token uses since','1795826419.0834072');
CREATE TABLE token (
    id TEXT PRIMARY KEY, name TEXT NOT NULL, role TEXT NOT NULL, salt BLOB NOT NULL, hash BLOB NOT NULL,
    created REAL NOT NULL, expires REAL NOT NULL, revoked REAL
) WITHOUT ROWID;
INSERT INTO "token" VALUES('26d2d688a713','reader','viewer',X'A1161C9F9F08A2C6504C4D750C9E9B4E',X'0000000000000000000000000000000000000000000000000000000000000000',1.7958264272867703438e+09,4102444800.0,NULL);
INSERT INTO "token" VALUES('9352c25226fe','first','admin',X'1127DFEB077E5C2DD825D7901FCC3CD9',X'0000000000000000000000000000000000000000000000000000000000000000',1.7958264191107640266e+09,4102444800.0,NULL);
INSERT INTO "token" VALUES('f232ed4d2bf9','gone','viewer',X'136E8AF879C604241E2C019E5CC13E0D',X'0000000000000000000000000000000000000000000000000000000000000000',1.79582642734885144231e+09,4102444800.0,1.79582642742186284062e+09);
CREATE TABLE token_keys (
    id TEXT PRIMARY KEY, reading BLOB NOT NULL, verifying BLOB NOT NULL
) WITHOUT ROWID;
INSERT INTO "token_keys" VALUES('26d2d688a713',X'0000000000000000000000000000000000000000000000000000000000000000',X'0000000000000000000000000000000000000000000000000000000000000000');
INSERT INTO "token_keys" VALUES('9352c25226fe',X'0000000000000000000000000000000000000000000000000000000000000000',X'0000000000000000000000000000000000000000000000000000000000000000');
INSERT INTO "token_keys" VALUES('f232ed4d2bf9',X'0000000000000000000000000000000000000000000000000000000000000000',X'0000000000000000000000000000000000000000000000000000000000000000');
CREATE TABLE token_left (id TEXT PRIMARY KEY, seconds REAL NOT NULL) WITHOUT ROWID;
INSERT INTO "token_left" VALUES('9352c25226fe',2306711064.0);
CREATE TABLE token_use (id TEXT PRIMARY KEY, used REAL NOT NULL) WITHOUT ROWID;
INSERT INTO "token_use" VALUES('9352c25226fe',1795733766.0);
COMMIT;
