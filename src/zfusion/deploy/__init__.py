"""From a scenario and a list of hosts to a folder for each host, with all that its processes need there.

    hosts      the hosts file: which nodes run where, addresses, topology, security
    plan       who runs where, listens where, dials whom; the command line of each process
    access     who may say what to whom, derived from the adjacency matrix
    zenoh_file the Zenoh configuration of each process
    identity   a small CA and a certificate for each process, or a user's own, checked
    bundle     the scenario with the data files that it names, to be read in another place
    folders    writes it all
    systemd    service units for it
    compose    a compose file for it
    kubernetes where hosts are pods: what kustomize is told instead

The folders, for ``zfusion deploy field.toml --hosts hosts.toml -o out``:

    out/zfusion-deploy.json        what was deployed: this is how a folder of ours is known
    out/ca/ca.pem, ca.key          the authority; its key stays here
    out/design.npz                 for methods that are designed off-line, unless the scenario names a file
    out/HOST/                      to be copied to that host; everything is run from inside it
        README                     what to start there
        scenario.toml              the same on all hosts, up to where its data files lie
        data/                      the files that the scenario names and that are needed on this host
        zenoh/PROCESS.json5        PROCESS is node-<id>, recorder, observer or router-<host>, as in the plan
        tls/ca.pem                 whom to believe
        tls/PROCESS.pem, .key      who it is: the common name is PROCESS
        systemd/                   its units, and how to install them
        compose.yaml               the same in containers
        recordings/                the recorder's, where there is one

Where hosts are pods there are neither units nor compose files, but ``out/kustomization.yaml`` and two patches.

Directories that hold keys have mode 0700, keys 0600. All paths in the files are relative to ``out/HOST``.
"""
