#!/usr/bin/env bash
# Starts or stops a one-node Slurm in a private folder for tests: no systemd, cgroups, database or root, loopback only.
# usage: MINI_SLURM_PORT=17000 mini-slurm.sh start|stop DIR; then SLURM_CONF=DIR/slurm.conf sbatch …
# Slurm uses that port and the next. The node has four configured cores on any machine. DIR must be short, because it contains a socket.
set -euo pipefail
verb=${1:?start|stop}; dir=$(realpath -m "${2:?a folder}"); port=${MINI_SLURM_PORT:-16817}
# Debian installs the daemons in /usr/sbin, which is not on an ordinary user's PATH.
PATH=$PATH:/usr/sbin
host=$(hostname -s); me=$(id -un)

stop() {
  for daemon in slurmd slurmctld munged; do
    if [ -s "$dir/$daemon.pid" ]; then kill "$(cat "$dir/$daemon.pid")" 2>/dev/null || true; fi
  done
}

configure() {
  local memory=$(($(awk '/MemTotal/ {print int($2 / 1024)}' /proc/meminfo) * 9 / 10)) gpus=${MINI_SLURM_FAKE_GPUS:-0} gres=
  : > "$dir/gres.conf"
  : > "$dir/cgroup.conf"
  if [ "$gpus" -gt 0 ]; then
    gres="Gres=gpu:$gpus"
    # Slurm requires a character device per GPU and reads the GPU's number from the end of the path.
    for i in $(seq 0 $((gpus - 1))); do
      ln -sfn /dev/null "$dir/gpu$i"
      echo "Name=gpu File=$dir/gpu$i" >> "$dir/gres.conf"
    done
  fi
  cat > "$dir/slurm.conf" <<CONF
ClusterName=mini
SlurmctldHost=$host(127.0.0.1)
SlurmUser=$me
SlurmdUser=$me
SlurmctldPort=$port
SlurmdPort=$((port + 1))
AuthType=auth/munge
CredType=cred/munge
AuthInfo=socket=$dir/munge.socket
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
StateSaveLocation=$dir/state
SlurmdSpoolDir=$dir/spool
SlurmctldPidFile=$dir/slurmctld.pid
SlurmdPidFile=$dir/slurmd.pid
SlurmctldLogFile=$dir/slurmctld.log
SlurmdLogFile=$dir/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=1,bf_interval=1,sched_min_interval=100000
SwitchType=switch/none
MpiDefault=none
ReturnToService=2
SlurmdParameters=config_overrides
MinJobAge=3600
KillWait=5
GresTypes=gpu
NodeName=$host NodeAddr=127.0.0.1 CPUs=4 RealMemory=$memory $gres State=UNKNOWN
PartitionName=main Nodes=$host Default=YES MaxTime=INFINITE DefMemPerCPU=256 State=UP
CONF
}

start() {
  mkdir -p "$dir"/{state,spool}
  chmod 700 "$dir"
  configure
  (umask 077 && head -c 1024 /dev/urandom > "$dir/munge.key")
  munged --key-file="$dir/munge.key" --socket="$dir/munge.socket" --pid-file="$dir/munged.pid" \
    --log-file="$dir/munged.log" --seed-file="$dir/munge.seed" --num-threads=2 --force
  slurmctld -f "$dir/slurm.conf"
  slurmd -f "$dir/slurm.conf"
  export SLURM_CONF=$dir/slurm.conf
  local pid=$dir/slurmctld.pid
  while [ "$SECONDS" -lt 60 ]; do
    # slurmctld exits at once if its port is in use; then each sinfo would block for seconds.
    if [ -s "$pid" ] && ! kill -0 "$(cat "$pid")" 2>/dev/null; then break; fi
    if [ "$(timeout 5 sinfo -h -o %T 2>/dev/null)" = idle ]; then exit 0; fi
    sleep 0.25
  done
  stop
  echo "the node did not become idle; see $dir/*.log" >&2
  exit 1
}

case $verb in
  start) start ;;
  stop) stop ;;
  *) echo "unknown verb $verb" >&2; exit 2 ;;
esac
