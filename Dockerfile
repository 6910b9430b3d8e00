# The appliance as a container image (target `appliance`, the default), and the simulated robot beside it (`demo`).
#
#     docker build --tag rosrv/appliance .
#     docker compose up                       # compose.yaml says with which rights, and why
#
# Debian's packages have their reasons in packages.txt; Python's are exactly those of requirements.lock, by hash.

# The name is for people, the digest (of the list for all architectures) is what is taken.
# Another base for a build without a registry: --build-arg BASE=…
ARG BASE=debian:12-slim@sha256:88200866dfff7ea7f5cbcb6ec7c8a701889efe6fe859fe64d6990e4b07ea4171


# --- the virtual environment: pip and the compiler stay here --------------------------------------------------------
FROM ${BASE} AS python
RUN apt-get update -q \
 && DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends \
        ca-certificates gcc libc6-dev python3-dev python3-venv python3-wheel
COPY requirements.lock /build/
# Two packages come as source: they are built with Debian's setuptools and wheel, so that nothing is fetched unlocked.
# Nothing in it tells when or where it was built: compiled files name their source by its content.
ENV PYTHONHASHSEED=0 CFLAGS="-O2 -g0" LDFLAGS=-Wl,--build-id=none
RUN python3 -m venv /opt/rosrv \
 && PYTHONPATH=/usr/lib/python3/dist-packages /opt/rosrv/bin/pip install --quiet --no-cache-dir --require-hashes --no-deps \
        --disable-pip-version-check --no-build-isolation --no-compile -r /build/requirements.lock \
 && /opt/rosrv/bin/pip uninstall --quiet --yes pip setuptools \
 # Of the packages' programs and tests nothing is needed; what debuggers want of their libraries neither.
 && find /opt/rosrv/bin -mindepth 1 ! -name 'python*' -delete \
 && find /opt/rosrv/lib -type d \( -name tests -o -name test_data \) -prune -exec rm -rf {} + \
 && find /opt/rosrv/lib -name '*.so' -exec strip --strip-unneeded {} + \
 && find /opt/rosrv/lib -name direct_url.json -delete
# The relay's compiled module, with the locked Cython, which stays here.
COPY requirements-bootstrap.lock /build/
COPY distribution/extension.py /build/distribution/
COPY appliance/relay/transport/pump.pyx /build/appliance/relay/transport/
RUN awk '/^[a-z]/ { taken = /^cython==/ } taken' /build/requirements-bootstrap.lock > /build/cython.lock \
 && python3 -m venv /build/cython \
 && /build/cython/bin/pip install --quiet --no-cache-dir --require-hashes --only-binary :all: --disable-pip-version-check \
        -r /build/cython.lock \
 && /build/cython/bin/python /build/distribution/extension.py
COPY appliance /opt/rosrv/lib/python3.11/site-packages/appliance
COPY roswire /opt/rosrv/lib/python3.11/site-packages/roswire
COPY rosmop /opt/rosrv/lib/python3.11/site-packages/rosmop
# What verbs read beside the program (appliance/base/shipped.py), such as the presets; also the first configuration, below.
COPY policies /opt/rosrv/share/rosrv/policies
COPY monitors /opt/rosrv/share/rosrv/monitors
# Rights and times of a checkout are its owner's. He may keep his files to himself (umask 077): the processes' users
# read them all the same; and when he fetched them is nothing that an image is to say.
RUN share=/opt/rosrv/share/rosrv && cd /opt/rosrv/lib/python3.11/site-packages \
 && cp /build/appliance/relay/transport/*.so appliance/relay/transport/ \
 && chmod -R u=rwX,go=rX appliance roswire rosmop $share \
 && find appliance roswire rosmop $share -exec touch {} + \
 && printf '#!/opt/rosrv/bin/python -P\nfrom appliance.cli.main import main\n\nmain()\n' > /opt/rosrv/bin/rosrv \
 && chmod 755 /opt/rosrv/bin/rosrv \
 && find /opt/rosrv/lib -name __pycache__ -prune -exec rm -rf {} + \
 && cd /opt/rosrv/lib/python3.11/site-packages \
 && compile="/opt/rosrv/bin/python -m compileall -q --invalidation-mode unchecked-hash" \
 && $compile appliance roswire rosmop \
 # Some packages carry templates that no interpreter takes; those are imported by nobody.
 && { $compile . > /dev/null || true; }


# --- the appliance ------------------------------------------------------------------------------------------------
FROM ${BASE} AS appliance
# iptables is the second back end of the firewall, for kernels without nftables; iproute2 finds out whether the kernel
# has ESP; tini is the first process: it passes signals on and collects the dead. The rest is in packages.txt.
# PINS: name=version of all that this brings (distribution/image-packages.lock). `make image` gives them, so that what is
# released can be built again; who builds for himself gets Debian's newest.
ARG PINS=""
RUN apt-get update -q \
 && DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends \
        charon-systemd \
        iproute2 \
        iptables \
        libcharon-extra-plugins \
        libseccomp2 \
        libstrongswan-standard-plugins \
        nftables \
        python3-rosmaster \
        rosout \
        strongswan-swanctl \
        tini \
        tzdata \
        ${PINS} \
 && apt-get clean \
 && rm -rf /var/lib/apt/lists/* /var/cache/* /var/log/* /usr/share/doc/*/changelog* /usr/share/man/* /tmp/* \
 # No program gives its caller more rights than he has.
 && find / -xdev -type f -perm /6000 -exec chmod a-s {} + \
 # One user for each process (appliance/supervisor/users.py); the numbers are the same everywhere.
 && for user in rosrv:61011 rosmaster:61012 rosrv-relay:61013 rosrv-api:61014 rosrv-signer:61015 rosrv-ipsec:61016 \
        rosrv-syslog:61017 rosrv-rosout:61018 rosrv-recorder:61019 rosrv-compiler:61020 rosrv-lease:61021 \
        rosrv-bundles:61022 rosrv-fleet:61023 rosrv-doors:61024 rosrv-sso:61025 \
        rosrv-hook:61026; do \
        printf '%s:x:%s:%s::/nonexistent:/usr/sbin/nologin\n' "${user%:*}" "${user#*:}" "${user#*:}" >> /etc/passwd; \
        printf '%s:x:%s:\n' "${user%:*}" "${user#*:}" >> /etc/group; \
    done \
 # root reads the audit log as a member of its group: without CAP_DAC_OVERRIDE it is a user like others.
 && sed -i '/^rosrv-api:/s/$/root/' /etc/group \
 && install -d -m 711 /var/lib/rosrv
COPY --from=python /opt/rosrv /opt/rosrv
COPY --from=python /opt/rosrv/share/rosrv /etc/rosrv
# The configuration of the container: mount another file here, or override a key with ROSRV_… (docs/operating.md).
# REST listens on all addresses because only then it can be published; the firewall lets in whom `api_networks` names.
RUN printf '%s\n' 'isolation: container' 'policy: policies/default.ini' 'monitors: monitors' 'enable: none' \
        'hosts: ipsec/hosts.yaml' 'api: 0.0.0.0:8443' > /etc/rosrv/appliance.yaml \
 && install -d /etc/rosrv/ipsec
ENV PATH=/opt/rosrv/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
    PYTHONDONTWRITEBYTECODE=1
WORKDIR /etc/rosrv
VOLUME /var/lib/rosrv
EXPOSE 500/udp 4500/udp 8443/tcp
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=5s --timeout=5s --start-period=60s --retries=3 \
    CMD ["python", "-P", "-m", "appliance.cli.healthy"]
ENTRYPOINT ["tini", "--"]
CMD ["rosrv", "up"]
ARG BASE
ARG VERSION=0.5.0.dev0
ARG REVISION=""
LABEL org.opencontainers.image.title="ROSRV appliance" \
      org.opencontainers.image.base.name="${BASE}" \
      org.opencontainers.image.revision="${REVISION}" \
      org.opencontainers.image.vendor="The ROSRV maintainers" \
      org.opencontainers.image.description="A network-security appliance for ROS 1 robots" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.version="${VERSION}"


# --- the simulated LandShark, its operator and an attacker: unmodified ROS nodes, nothing of the appliance ----------
FROM ${BASE} AS radar
RUN apt-get update -q \
 && DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends \
        g++ libgeometry-msgs-dev libroscpp-dev libstd-msgs-dev pkg-config
COPY scripts/build-roscpp /build/
COPY examples/landshark/nodes/radar.cpp /build/
RUN /build/build-roscpp /build/radar.cpp /build/radar && chmod 755 /build/radar

FROM ${BASE} AS demo
RUN apt-get update -q \
 && DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends \
        libroscpp4d \
        python3-genpy \
        python3-geometry-msgs \
        python3-nav-msgs \
        python3-rosnode \
        python3-rospy \
        python3-rosservice \
        python3-rostopic \
        python3-sensor-msgs \
        python3-std-msgs \
        tini \
 && rm -rf /var/lib/apt/lists/*
COPY monitors/msg /opt/landshark/msg
COPY examples/landshark/nodes /opt/landshark/nodes
COPY examples/landshark/robot /opt/landshark/
COPY --from=radar /build/radar /opt/landshark/nodes/radar
# As above: a checkout under umask 077 is its owner's alone, and the nodes run as another user.
RUN chmod -R go+rX /opt/landshark
ENV LANDSHARK_MESSAGES=/opt/landshark/msg PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 \
    ROS_HOME=/tmp/ros
WORKDIR /opt/landshark/nodes
USER 1000:1000
ENTRYPOINT ["tini", "-g", "--"]


# `docker build` without --target makes the appliance.
FROM appliance
