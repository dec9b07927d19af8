<#
.SYNOPSIS
Makes this PC a terrafarm worker: a scheduled task that starts with Windows.

.DESCRIPTION
Run it as administrator. The worker runs as LOCAL SERVICE, whether or not somebody is logged on,
below the priority of whoever sits at the PC. It waits for a coordinator that is away. When the
task ends, Windows kills the process: its jobs are rendered by others, and nothing is lost.

    .\worker.ps1 install -Coordinator pc-one:7070 -Program .\terrafarm.exe
    .\worker.ps1 install -Coordinator pc-one:7070 -Program .\terrafarm.exe -Threads 6
    .\worker.ps1 status
    .\worker.ps1 uninstall

.PARAMETER Action
install, status or uninstall. Installing again replaces program and settings.
.PARAMETER Coordinator
HOST:PORT of the coordinator.
.PARAMETER Program
The terrafarm.exe to copy to this PC's programs.
.PARAMETER Threads
Threads to render with; all cores if not said.
#>
[CmdletBinding()]
param(
    [Parameter(Mandatory, Position = 0)]
    [ValidateSet('install', 'status', 'uninstall')]
    [string] $Action,

    [ValidatePattern('^[A-Za-z0-9._\-\[\]:]+:[0-9]+$')]
    [string] $Coordinator,

    [string] $Program,

    [ValidateRange(0, 4096)]
    [int] $Threads = 0
)

Set-StrictMode -Version Latest
$ErrorActionPreference = 'Stop'

$TaskName = 'terrafarm worker'
$Folder = Join-Path $env:ProgramFiles 'terrafarm'
$Installed = Join-Path $Folder 'terrafarm.exe'
$Cache = Join-Path $env:ProgramData 'terrafarm'
$LocalService = 'S-1-5-19'

function Assert-Administrator {
    $identity = [Security.Principal.WindowsIdentity]::GetCurrent()
    $principal = [Security.Principal.WindowsPrincipal]::new($identity)
    if (-not $principal.IsInRole([Security.Principal.WindowsBuiltInRole]::Administrator)) {
        throw 'this has to be run as administrator'
    }
}

# The program's file cannot be replaced while it runs, and Windows takes a moment to end it.
function Stop-Worker {
    if (-not (Get-ScheduledTask -TaskName $TaskName -ErrorAction SilentlyContinue)) {
        return
    }
    Stop-ScheduledTask -TaskName $TaskName
    $running = Get-Process -Name 'terrafarm' -ErrorAction SilentlyContinue |
        Where-Object { $_.Path -eq $Installed }
    if ($running) {
        $running | Wait-Process -Timeout 30
    }
}

function Install-Worker {
    if (-not $Coordinator) { throw 'install needs -Coordinator HOST:PORT' }
    if (-not $Program) { throw 'install needs -Program, the terrafarm.exe to copy' }
    if (-not (Test-Path -LiteralPath $Program -PathType Leaf)) { throw "$Program is not there" }

    Stop-Worker
    New-Item -ItemType Directory -Force -Path $Folder, $Cache | Out-Null
    Copy-Item -LiteralPath $Program -Destination $Installed -Force
    # LOCAL SERVICE may write its cache and nothing else of ours.
    & icacls.exe $Cache /grant "*${LocalService}:(OI)(CI)M" | Out-Null
    if ($LASTEXITCODE -ne 0) { throw "icacls cannot give $Cache to LOCAL SERVICE" }

    $arguments = "worker --coordinator $Coordinator --cache-dir `"$Cache`""
    if ($Threads -gt 0) { $arguments += " --threads $Threads" }
    $start = New-ScheduledTaskAction -Execute $Installed -Argument $arguments
    $when = New-ScheduledTaskTrigger -AtStartup
    $who = New-ScheduledTaskPrincipal -UserId 'NT AUTHORITY\LOCAL SERVICE' -LogonType ServiceAccount
    # Priority 7 is below normal. Without these settings a task ends after three days and does
    # not start on battery.
    $how = New-ScheduledTaskSettingsSet -Priority 7 -ExecutionTimeLimit ([TimeSpan]::Zero) `
        -RestartCount 999 -RestartInterval (New-TimeSpan -Minutes 1) -MultipleInstances IgnoreNew `
        -AllowStartIfOnBatteries -DontStopIfGoingOnBatteries
    Register-ScheduledTask -TaskName $TaskName -Action $start -Trigger $when -Principal $who `
        -Settings $how -Force | Out-Null
    Start-ScheduledTask -TaskName $TaskName
    "$TaskName is installed and works for $Coordinator"
}

function Uninstall-Worker {
    Stop-Worker
    if (Get-ScheduledTask -TaskName $TaskName -ErrorAction SilentlyContinue) {
        Unregister-ScheduledTask -TaskName $TaskName -Confirm:$false
    }
    foreach ($path in $Folder, $Cache) {
        if (Test-Path -LiteralPath $path) { Remove-Item -LiteralPath $path -Recurse -Force }
    }
    "$TaskName is gone"
}

switch ($Action) {
    'install' { Assert-Administrator; Install-Worker }
    'uninstall' { Assert-Administrator; Uninstall-Worker }
    'status' {
        $task = Get-ScheduledTask -TaskName $TaskName -ErrorAction SilentlyContinue
        if (-not $task) { throw "$TaskName is not installed" }
        "$TaskName is $($task.State)"
    }
}
