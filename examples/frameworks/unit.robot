*** Settings ***
Documentation    robot --pythonpath examples/frameworks examples/frameworks/unit.robot
Library          UnitLibrary

*** Test Cases ***
Unit Is As New
    ${result}=    Run Built In Test    open
    FOR    ${name}    IN    Kintas    FSS    FDJ
        Severity Should Be Below    ${result}    ${name}    0.25
    END
